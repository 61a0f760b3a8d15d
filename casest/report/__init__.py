"""What a person reads. Text and page import results and nothing else, nor each other."""
