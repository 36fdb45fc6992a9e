"""From a field to a closed triangle mesh."""
