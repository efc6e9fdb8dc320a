"""Experiments through the daemon: designed, asked for, run, recorded and decided."""
