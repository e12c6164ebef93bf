"""Errors that a user can act on, with the exit code of the command line for each."""


class G3RError(Exception):
    """Base of every error that g3r raises on purpose; the message is one actionable line."""

    exit_code = 1

    def __str__(self) -> str:
        """The message on one line, whatever file names and headers brought along."""
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in super().__str__())


class InputError(G3RError):
    """The input cannot be used: names the file, what was found, what was expected, what to do."""

    exit_code = 3


class NumericalError(G3RError):
    """The computation did not hold; what exists so far is kept and marked."""

    exit_code = 4
