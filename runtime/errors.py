"""The one exception of the runtime's readers: a file is at fault, not this program."""


class AssetError(Exception):
    """A file that cannot be used.

    The message is one line: what is wrong, where (file, accessor, texture), what to do.
    """
