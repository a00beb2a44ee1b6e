"""People and their hands, made from the free body model Anny by the scripts here."""
