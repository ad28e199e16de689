"""The laboratory: methods side by side, and equations of papers measured on the user's data."""
