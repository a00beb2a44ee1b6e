"""Commands that reach into several rooms, a file each. The others lie in the room that they are about."""
