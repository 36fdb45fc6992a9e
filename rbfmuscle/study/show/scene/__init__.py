"""A scene before it runs."""
