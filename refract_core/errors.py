"""Every way a call can fail, on one screen.

RefractError
├── UsageError        a flag, setting or argument is wrong                     exit code 2
├── StageError        the stage cannot be opened, composed or read             exit code 1
├── SceneError        a record of arrays is malformed (wrong shape, NaN, ...)   exit code 1
├── ImageError        a texture cannot be read or a picture cannot be written  exit code 1
├── EmbreeError       Embree is missing or refused something                   exit code 1
├── TimeUp            the time limit came before a whole picture was there     exit code 1
└── Cancelled         the caller asked to stop                                 exit code 3

A message says what is wrong, where (prim path, flag or field), the valid range and what to do.
A ray that fails is a status in an array, never one of these.
"""


class RefractError(Exception):
    """Base of everything this package raises on purpose."""

    exit_code = 1


class UsageError(RefractError):
    """A flag, setting or argument is out of its range."""

    exit_code = 2


class StageError(RefractError):
    """The stage cannot be opened, composed or read."""


class SceneError(RefractError):
    """A record of arrays breaks its own contract."""


class ImageError(RefractError):
    """A texture cannot be read or a picture cannot be written."""


class EmbreeError(RefractError):
    """Embree is missing, too old, or refused a call."""


class TimeUp(RefractError):
    """The time limit has come before every pixel was drawn; nothing was written."""


class Cancelled(RefractError):
    """The caller asked to stop; nothing was written."""

    exit_code = 3
