#define P2GS_NS avx2
#include "isa_body.inc"
