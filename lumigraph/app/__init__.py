"""The app: photographs in and scene out, in a browser."""
