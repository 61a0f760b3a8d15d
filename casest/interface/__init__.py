"""What Python is given: data in any shape in; estimates that print, save, plot and correct out."""
