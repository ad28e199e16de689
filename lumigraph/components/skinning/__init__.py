"""Skinning: bones at moments with learnt corrections, weights of bones as a volume, and the poses of a user."""
