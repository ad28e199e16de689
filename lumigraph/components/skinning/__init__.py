"""Skinning: bones over time with learnt corrections, a volume of skinning weights, and poses of a user."""
