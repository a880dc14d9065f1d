"""HTTP in front of the renderer: requests, queue, one-shot workers, limits."""
