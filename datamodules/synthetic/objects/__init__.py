"""Built-in objects, each a surface and its paint."""
