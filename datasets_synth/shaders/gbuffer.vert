#version 450
// From corners of panels to the picture. SAPIEN finds what it fills in by the names of blocks and members; those of
// the blocks below, the order of the sets and the file names are therefore its own.

layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} camera;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} thing;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} about;

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec3 tangent;
layout(location = 4) in vec3 bitangent;

layout(location = 0) out vec4 place;  // in the world, and z depth
layout(location = 1) out vec3 upright;
layout(location = 2) out vec3 towardsEye;
layout(location = 3) out vec2 texel;
layout(location = 4) flat out uint entity;

void main() {
  vec4 inWorld = thing.modelMatrix * vec4(position, 1);
  vec4 inCamera = camera.viewMatrix * inWorld;
  place = vec4(inWorld.xyz, -inCamera.z);
  upright = mat3(thing.modelMatrix) * normal;
  towardsEye = camera.viewMatrixInverse[3].xyz - inWorld.xyz;
  texel = uv;
  entity = about.segmentation.y;
  gl_Position = camera.projectionMatrix * inCamera;
}
