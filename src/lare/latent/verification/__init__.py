"""What a program must do before it is believed."""
