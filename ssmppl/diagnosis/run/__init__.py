"""What a diagnosis runs on: its checkpoint, the parts that failed, seeds, the expected time."""
