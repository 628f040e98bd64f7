"""`refgs view`: a page to orbit a reconstruction on, drawn by the renderer itself."""
