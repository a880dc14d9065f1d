"""Glass found by its own shaders, and RefractMaterialAPI written over it; glTF files as stages."""

__all__ = ["author", "find", "gltf_file", "gltf_stage", "shapes", "surfaces"]
