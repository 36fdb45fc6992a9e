"""Scenes: bones, joints, muscles, motions and their files."""
