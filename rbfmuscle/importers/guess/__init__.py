"""A scene guessed from meshes."""
