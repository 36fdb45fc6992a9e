"""A scene to start from, guessed from meshes: what each is, which bones move, where muscles hold."""
