"""What every other room stands on: pytrees, checks of arguments, status bits. No idea of rendering."""
