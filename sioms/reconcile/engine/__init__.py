"""What axes and sensors are reconciled by: free numbers and fits, the search, confounders, what speaks for a name."""
