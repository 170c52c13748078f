"""What goes wrong in words a user can act on.

Every message is one sentence or two: what, where, what to do. The script seam (`drivesplat.workflow.job`) prints the
message alone; anything else that is raised is a bug and keeps its traceback in the job's log.
"""


class DriveSplatError(Exception):
    """A failure with a message for the user. Its text is one line."""

    def __init__(self, message: str):
        super().__init__(" ".join(message.split()))


class ConfigError(DriveSplatError):
    """A setting is unknown, out of range or contradicts another."""


class DatasetError(DriveSplatError):
    """The recorded drive is missing, incomplete or malformed."""


class ResultError(DriveSplatError):
    """A file of an earlier stage is truncated, foreign or unsafe."""


class DeviceError(DriveSplatError):
    """The compute device is absent, full or unusable."""


class RequestError(DriveSplatError, ValueError):
    """A call of the Python interface asks for what a drive cannot give."""


class UnknownObjectError(RequestError, KeyError):
    """A call of the Python interface names an object that is not there."""

    __str__ = Exception.__str__  # that of KeyError puts its text in quotes


class TrainingError(DriveSplatError):
    """The optimisation cannot go on."""
