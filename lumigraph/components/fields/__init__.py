"""Representations: encodings, networks, fields, codes of photographs, teachers."""
