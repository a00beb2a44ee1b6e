"""How a person holds things and asks for them."""
