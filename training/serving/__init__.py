"""`dengine serve` tried from outside: how long it takes to answer, and what a kill takes back."""
