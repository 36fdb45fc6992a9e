"""From centres and values to weights: systems, factors, conditions, cross-validation."""
