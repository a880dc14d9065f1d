"""What a person can ask for, from Python, the command line or HTTP: render files, turn, bake, compare, convert,
inspect, validate, warm up, look after the installation. Knows neither of the three.
"""

__all__ = [
    "bake_probes",
    "bake_thickness",
    "compare",
    "compare_pictures",
    "compare_renders",
    "compare_report",
    "convert",
    "doctor",
    "executors",
    "inspect",
    "join",
    "node",
    "override",
    "render_files",
    "samples",
    "schema",
    "table",
    "turntable",
    "validate",
    "validate_forms",
    "validate_many",
    "warm",
]
