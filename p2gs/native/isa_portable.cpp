#define P2GS_NS portable
#include "isa_body.inc"
