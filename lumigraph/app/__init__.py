"""The app: from photographs to a scene in a browser."""
