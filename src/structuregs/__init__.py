"""structuregs: photos of an articulated object in two states go in; a working digital twin comes out."""
