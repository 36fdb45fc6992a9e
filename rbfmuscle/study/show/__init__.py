"""Pictures, pages and the window."""
