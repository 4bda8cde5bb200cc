"""Meshes to and from other libraries, each imported where it is used."""
