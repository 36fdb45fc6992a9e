"""A run as one moving thing: USD, animated glTF and VTKHDF."""
