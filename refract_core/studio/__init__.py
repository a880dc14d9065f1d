"""A studio for things that come without light: a dome with soft boxes in it, and a floor. All of it is made here, from
the bounds of what is drawn and the camera's side of it, so huge and tiny things look equal.
"""

__all__ = ["compose"]
