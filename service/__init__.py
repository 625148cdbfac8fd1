"""The service: everything that talks (Zenoh, command line, files, recordings)."""
