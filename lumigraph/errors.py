"""Errors and warnings that a user can act on."""


class LumigraphError(Exception):
    """A fault in the input or the surroundings, in one sentence: where, what is wrong, what to do.

    The command line prints the sentence and exits with code 2; a program may catch it.
    """


class LumigraphWarning(UserWarning):
    """Something that a user should know but that does not stop the work, in one sentence."""
