"""Exceptions of engines, which the native modules raise."""


class EngineLost(ConnectionError):
    """The engine has ended, or has been replaced by another engine."""

    __module__ = "endless_gym"


class TooManyBatchesHeld(BufferError):
    """Arrays of this process hold all batches that the engine can lend."""

    __module__ = "endless_gym"
