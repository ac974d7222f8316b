"""The one exception that means: the input or an argument is at fault, not this program."""

from runtime.errors import one_line


class InputError(Exception):
    """A bad file or argument.

    The message is one line: what is wrong, where (file, mesh, face, accessor), what to do.
    The command line prints it alone and exits with status 2.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(message))
