"""What a stage should keep, what was found against it, and how it is mended; what a person sees of a stage."""

__all__ = ["glass", "look", "plugin", "probes", "stage", "values"]
