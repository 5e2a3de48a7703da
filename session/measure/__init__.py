"""What measures models, cuts, haptics and timing, and writes the pages of docs/ about them."""
