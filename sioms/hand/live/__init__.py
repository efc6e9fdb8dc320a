"""Skills on the hand of a running workcell; what knows the client and its clock."""
