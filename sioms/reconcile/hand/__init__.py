"""Reconcile for the two-fingered hand: what its nominal model does not say about recorded grasps."""
