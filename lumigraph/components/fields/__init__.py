"""What representations are made of: encodings, networks, how points turn into coordinates."""
