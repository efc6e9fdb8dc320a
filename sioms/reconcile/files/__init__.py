"""What people have, read: tables with a short TOML, folders of recordings, model files."""
