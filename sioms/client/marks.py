"""How verbs are marked: type checkers see those of their face (``typed_faces``), a running program loads none of it."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .typed_faces import Generic as Generic
    from .typed_faces import stream as stream
    from .typed_faces import verb as verb
else:

    class Generic:
        """``typing.Generic``, as far as a running program needs it: its module is a fifth of a shell tool's start."""

        __class_getitem__ = classmethod(lambda cls, _parameters: cls)

    def verb(function):
        """Mark a verb: type checkers see that of the face."""
        return function

    stream = verb
