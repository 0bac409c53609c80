"""Parameters by how images look as wholes: the way for photographs."""
