"""The one exception for input a person can mend."""


class InputError(ValueError):
    """Bad input: the message names the file, the field and the remedy.

    The command line prints it as one sentence and exits with code 2.
    """
