"""The one error that a person caused and can mend."""


class InputError(Exception):
    """An input is wrong. The message is one line that names the input and says what is allowed.

    The command line prints it alone, without a traceback, and ends with exit status 2.
    """
