"""Watching axes in production: a twin of each, kept by regression over its recorded moves, and drifts told by name.

From the samples of moves (``moves``) come the regressors of force (``rows``), from the moves of some twenty seconds
of motion numbers of the axis with their information (``blocks``), from those of a commissioning phase what is normal
(``normal``), from later ones whether something has changed (``changes``), which cause separates from all others
(``causes``), and what would make up for it (``propose``). ``axis`` puts them together for one axis, ``keep`` makes a
text of its state. Nothing here reads a clock, a file or a node, and nothing moves anything.

Conventions: numbers of an axis in its own units (m or rad, N or N m), times in seconds of the axis's clock. Forces
are those commanded to the drive, so all numbers are relative to its nominal force constant.
"""
