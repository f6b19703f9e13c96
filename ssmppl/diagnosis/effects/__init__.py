"""Effects that a model may lack: what one is, and the catalogue of those that are looked for."""
