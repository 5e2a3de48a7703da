"""From the surface of an organ to a mesh and a scene."""
