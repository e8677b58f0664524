"""The one error that the user causes and can fix."""


class InputError(Exception):
    """An input is wrong. The message is one line that names the input and says what is allowed.

    The command line prints it alone, without a traceback, and ends with exit status 2.
    """
