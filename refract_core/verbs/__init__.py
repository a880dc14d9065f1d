"""What a person can ask for, from Python, the command line or HTTP: render files, bake, compare, convert, inspect,
validate, warm up. Knows neither of the three.
"""

__all__ = [
    "bake_probes",
    "bake_thickness",
    "compare",
    "compare_pictures",
    "compare_renders",
    "compare_report",
    "convert",
    "executors",
    "inspect",
    "node",
    "override",
    "render_files",
    "validate",
    "validate_forms",
    "validate_many",
    "warm",
]
