"""What a stage should keep, what is found against it, and how that is mended; what a person sees of a stage. Knows no
command. USD itself enters by `plugin`, which no other wing needs.
"""

__all__ = ["findings", "glass", "overview", "probes", "stage"]
