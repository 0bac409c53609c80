"""Columns of the tables that the host fills and the mesh kernels read; all tables are flat, rows one after another."""

NEAR = 0.1  # metres; nothing nearer along the camera's z is seen

# One row an instance, int64. The first six are the mesh's, as in the atlas; NODE is -1 without a label; SEEN, whether
# it may be in the image, and CASTS, whether its shadow may be; MAP_BOX its first and last texels on the shadow map, one
# more on all sides, the last before the first if it casts none.
VERTEX, VERTICES, TRIANGLE, TRIANGLES, TEXTURE, CLOSED, NODE, SEMANTIC, SEEN, CASTS, MAP_BOX = range(11)
INTEGERS = 15

# One row an instance, float64: 3 x 4 matrices to pixels times depth (u z, v z, z) and to the shadow map (column, row,
# metres towards the sun); what a normal is multiplied by for the sun's cosine, and, an axis each, to turn it upright
# and unscaled; the tint.
TO_IMAGE, TO_MAP, TO_SUN, UNSCALE, TINT, REALS = 0, 12, 24, 27, 30, 33

# One row a scene, float64. RAY: the world's x, y and z along a pixel's ray for each metre of depth, each a constant
# and what a column and a row add; EYE: where the camera is; from LIGHT on, LIGHTS numbers of which shading needs all.
# TEXEL: metres from corner to corner of a texel of the shadow map.
RAY, EYE, GROUNDED, OFFSET, SUN_UP, TEXEL, LIGHT = 0, 9, 12, 13, 14, 15, 16
# Light is as the image shows it, exposure included. MORE: the zenith's colour less the horizon's; LENS: one over the
# focal length and the principal point; ON_MAP: column, row and metres towards the sun on the shadow map, each of the
# eye, and of the ray like RAY; CLIMB: z of RAY.
SUN, AMBIENT, HAZE, SHADOWED, HORIZON, MORE, LENS, ON_MAP, CLIMB, LIGHTS = 0, 1, 2, 3, 4, 7, 10, 13, 25, 28
SCENE = LIGHT + LIGHTS

# One row a node, int32 and float64: extent and pixels of the visible mask, pixels of the silhouette in the image;
# extent of the silhouette on an endless canvas.
BOX, PIXELS, WHOLE, RESULTS = 0, 4, 5, 6
EXTENT = 4
