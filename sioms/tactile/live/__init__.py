"""Touches of a finger through the daemon: the prober and its simulated workcell."""
