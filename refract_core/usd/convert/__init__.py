"""Glass found by its own shaders, and RefractMaterialAPI written over it; glTF files as stages. Chooses no model.
"""

__all__ = ["author", "find", "gltf_stage", "gltf_write", "mtlx_write", "standard", "uses"]
