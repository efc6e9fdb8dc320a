"""SIOMS: workcell devices as UNIX-like device nodes."""
