"""The one exception a user is meant to read."""


class UsageError(ValueError):
    """Input that cannot be worked with; the message is one line that names the value and the remedy."""
