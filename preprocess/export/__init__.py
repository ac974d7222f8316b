"""The folder of a built character: model.glb, images, manifest, report."""
