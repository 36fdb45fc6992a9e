"""The frame loop: contacts, tunnelling, overlap, sliding."""
