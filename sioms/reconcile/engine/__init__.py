"""What axes and sensors are reconciled by: free numbers and fits, the search, look-alikes, what speaks for a name."""
