#define P2GS_NS avx512
#include "isa_body.inc"
