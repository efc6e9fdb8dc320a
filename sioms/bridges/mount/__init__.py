"""Device nodes as files, by FUSE: what the shell and every program can open, read, write, poll and close."""
