"""Numbers with known noise that frames and forward model both give."""
