"""What is simulated: the scene, its file, its meshes, its motion, its settings."""
