"""A trained scene under another light: pictures, a scene file, and the score where the truth is known."""
