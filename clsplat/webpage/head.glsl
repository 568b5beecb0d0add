#version 300 es
// head.glsl: begins every shader.
precision highp float;
precision highp int;
precision highp sampler2D;
