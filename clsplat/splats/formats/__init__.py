"""File formats of splats: a reader and a writer each, and what chooses among them."""
