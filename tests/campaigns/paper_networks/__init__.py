"""The paper's three networks and its recipe: built, trained, exported and compared."""
