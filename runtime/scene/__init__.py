"""What a caller places: actors, cameras, lights; and which level of detail each is drawn at."""
