"""Recording while it happens: an ordinary client that reads the rings of pages and journals."""
