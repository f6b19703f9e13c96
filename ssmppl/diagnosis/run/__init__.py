"""What a diagnosis runs on: its checkpoint, the parts that failed, the time it will take."""
