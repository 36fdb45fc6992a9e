"""The page of a kernel study: its table, its plots, its surfaces."""
