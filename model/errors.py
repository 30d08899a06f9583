"""What model/ says to people; any other ValueError is a bug."""


class InputError(ValueError):
    """Something a person can mend: the message says what was given, what was expected and what to do."""

    status = 2  # of the command that stops with it, as of pipeline.errors.UserError
