"""The author's tools: ``sioms driver check``, ``trace`` and ``replay``.

A station puts a driver to work under the real daemon, against its simulator, over a wire that can be disturbed; driver
and simulator know nothing of it. Trials disturb, stop and kill, and say what they saw.
"""
