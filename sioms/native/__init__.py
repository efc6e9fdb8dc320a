"""Steps: what runs in every tick, written in a small part of Python that is also compiled.

A *step* is a function over records of numbers and arrays (``language``). Its module is ordinary Python and runs as
such; ``translate`` turns the modules named in ``language.MODULES`` into one C file, and ``build`` makes a shared
library of it that needs neither headers nor a library of Python. Where the library is there, and made of these very
sources, it is what runs; the numbers are the same bit for bit. Why so:
docs/decisions/0260-steps-are-python-that-compiles.md.
"""
