"""Work that goes on after a kill: what is kept on disk, and what it may be continued with."""
