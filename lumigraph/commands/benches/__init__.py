"""What can be measured: a file each."""
