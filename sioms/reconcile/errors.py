"""The one error of the workflow."""


class BadInputError(ValueError):
    """The data or the model cannot be used; the message says what is wrong and what would be right."""
