"""What scenes are drawn with: meshes, textures and surfaces."""
