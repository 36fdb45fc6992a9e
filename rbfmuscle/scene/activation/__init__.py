"""Muscles that contract: keys, activation curves and the law of fibres."""
