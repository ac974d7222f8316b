"""The exception of the demos that means: an argument or the machine is at fault, not this program."""


class DemoError(Exception):
    """Something a person can mend.

    The message is one line: what is wrong, with what, what to do. The command line prints it and exits with status 2.
    """
