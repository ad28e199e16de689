"""Whether a command answers whatever it is given by doing it, or by one sentence: inputs, and a watch over each."""
