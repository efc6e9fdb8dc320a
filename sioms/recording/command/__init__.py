"""Commands about recordings: ``sioms record``, ``log``, ``replay`` and ``blackbox``."""
