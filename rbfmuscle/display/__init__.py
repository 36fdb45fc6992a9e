"""How runs and studies are shown: pages, pictures, exports."""
