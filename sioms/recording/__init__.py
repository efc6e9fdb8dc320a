"""Recordings: MCAP files of everything that a workcell publishes and is told; what reads them knows no client.

``mcap`` is the format, ``messages`` what is in it, ``reader`` and ``rewrite`` work on files, ``live`` records and
``command`` is the command line. docs/recording.md describes the files, docs/decisions/0250-recordings.md why they are
so.
"""
