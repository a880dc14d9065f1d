"""Glass found by its own shaders, and RefractMaterialAPI written over it; glTF files as stages. Does not decide which
model suits a shape.
"""

__all__ = ["author", "find", "gltf_stage", "standard", "uses"]
