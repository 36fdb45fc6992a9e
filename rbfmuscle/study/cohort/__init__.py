"""Many scenes as one study: subjects and trials."""
