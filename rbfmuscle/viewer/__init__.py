"""A scene or a saved run in a browser or a notebook."""
