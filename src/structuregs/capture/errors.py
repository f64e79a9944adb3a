"""The error that a folder of images can cause."""


class CaptureError(ValueError):
    """Something in a capture folder that its owner must mend; the message says what, where, and what to do."""
