"""The panels beside the picture: each adds its controls to a `Page`, and asks its loop for what they do."""
