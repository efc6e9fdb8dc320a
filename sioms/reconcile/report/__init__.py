"""What is told: pages, pictures and verdict.json, and the pages of the libraries of effects."""
