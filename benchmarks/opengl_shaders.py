"""GLSL of the mesh renderer's peer: the same street, lit and shaded by the same sums."""

HEAD = "#version 330\n"
SHADED = """
uniform sampler2DShadow shadow;
uniform float map_size;
uniform vec3 sun;
uniform float haze;
uniform vec3 horizon;
uniform int label;
layout(location = 0) out vec4 image;
layout(location = 1) out int id;
void shade(vec3 albedo, vec3 normal, vec3 lit, float far) {
    float cosine = max(dot(normal, sun), 0.0);
    vec3 at = vec3((lit.xy + 0.5) / map_size, -(lit.z + 0.1) / 800 + 0.5);
    bool inside = all(greaterThan(at.xy, vec2(0))) && all(lessThan(at.xy, vec2(1)));
    if (cosine > 0 && inside) cosine *= texture(shadow, at);
    vec3 colour = albedo * (0.7 * cosine + 0.45 * (0.75 + 0.25 * normal.z));
    image = vec4(mix(horizon, colour, exp(-haze * far)), 1);
    id = label;
}
"""
MAP_VERTEX = """
uniform vec4 to_map[3];
uniform float map_size;
in vec3 position;
void main() {
    vec4 p = vec4(position, 1);
    vec2 at = (vec2(dot(to_map[0], p), dot(to_map[1], p)) + 0.5) / map_size * 2 - 1;
    gl_Position = vec4(at, -dot(to_map[2], p) / 400, 1);
}"""
EMPTY = "void main() {}"
VERTEX = """
uniform vec4 to_image[3];
uniform vec4 to_map[3];
uniform mat3 turn;
uniform vec3 tint;
uniform vec2 canvas;
in vec3 position;
in vec3 normal;
in vec2 uv;
in vec3 colour;
out vec3 facing;
out vec2 place;
out vec3 base;
out vec3 lit;
out float far;
void main() {
    vec4 p = vec4(position, 1);
    vec3 at = vec3(dot(to_image[0], p), dot(to_image[1], p), dot(to_image[2], p));
    lit = vec3(dot(to_map[0], p), dot(to_map[1], p), dot(to_map[2], p));
    facing = turn * normal;
    place = uv;
    base = colour * tint;
    far = at.z;
    gl_Position = vec4((at.xy + 0.5 * at.z) / canvas * 2 - at.z, at.z * 1.0004 - 0.20004, at.z);
}"""
MESH_FRAGMENT = """
uniform sampler2D panes;
uniform bool textured;
in vec3 facing;
in vec2 place;
in vec3 base;
in vec3 lit;
in float far;
void main() {
    vec3 albedo = base;
    if (textured) albedo *= texture(panes, place).rgb;
    shade(albedo, facing, lit, far);
}"""
GROUND_VERTEX = """
uniform mat3 to_image;
uniform vec3 eye;
uniform vec4 to_map[3];
uniform vec2 canvas;
in vec2 position;
out vec2 where;
out vec3 lit;
out float far;
void main() {
    vec3 at = to_image * (vec3(position, 0) - eye);
    vec4 p = vec4(position, 0, 1);
    lit = vec3(dot(to_map[0], p), dot(to_map[1], p), dot(to_map[2], p));
    where = position;
    far = at.z;
    gl_Position = vec4((at.xy + 0.5 * at.z) / canvas * 2 - at.z, at.z * 1.0004 - 0.20004, at.z);
}"""
GROUND_FRAGMENT = """
uniform float edges[6];
uniform int choice[7];
uniform sampler2DArray surfaces;
in vec2 where;
in vec3 lit;
in float far;
void main() {
    int strip = 0;
    while (strip < 6 && where.y >= edges[strip]) strip += 1;
    vec3 albedo = texture(surfaces, vec3(-where.y / 4, where.x / 4, choice[strip])).rgb;
    shade(albedo, vec3(0, 0, 1), lit, far);
}"""
SKY_VERTEX = """
in vec2 position;
out vec2 at;
void main() { at = position; gl_Position = vec4(position, 0.999999, 1); }"""
SKY_FRAGMENT = """
uniform vec2 canvas;
uniform vec3 lens;
uniform vec3 zenith;
uniform vec3 horizon;
in vec2 at;
layout(location = 0) out vec4 image;
layout(location = 1) out int id;
void main() {
    vec2 ray = ((at + 1) / 2 * canvas - 0.5 - lens.yz) / lens.x;
    image = vec4(mix(horizon, zenith, max(-ray.y * inversesqrt(1 + dot(ray, ray)), 0.0)), 1);
    id = 0;
}"""
