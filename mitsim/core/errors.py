"""The one exception for what a user can cause and mend."""


class MitsimError(Exception):
    """A request that cannot be served; the command line prints it on one line and exits with status 2.

    The message is one line: what is wrong, where, the value received, what is allowed, and what to do.
    """
