"""Mosaics: of two pictures, of many, and of a stream as it comes.

job          what a run is given; whether it is one of pictures or of a stream
pairs/       two pictures -> Link (gated mapping with its evidence)
pictures/    many pictures: which belong together, where each lies, one picture of all
stream/      sparse tiles that grow as frames are painted in
adjustment   Links -> one world for all pictures or keyframes (flat scenes)
"""
