"""One picture: actors gathered into draw batches and drawn in a view."""
