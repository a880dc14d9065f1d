"""What the camera has: its rays, the opaque picture with its pyramids, what the screen can answer, a frame's
planes.
"""

__all__ = ["camera", "crop", "gbuffer", "mattes", "orbit", "places", "planes", "pyramid", "quiet", "screen"]
