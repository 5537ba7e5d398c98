// The table of kernels that every instruction set exports, and the choice between them at run time.
//
// A kernel lives in a .inc file that isa_body.inc includes inside namespace p2gs::<isa>, once per instruction set. Rules there:
// no std containers or other inline library code with external linkage (the linker may keep the AVX-512 copy for everybody),
// no target attributes, scratch memory comes from the caller.
#pragma once

#include <cstdint>

#include "adam.h"
#include "assign.h"
#include "blend.h"
#include "carry.h"
#include "evidence.h"
#include "fuse.h"
#include "graph.h"
#include "image.h"
#include "knn.h"
#include "landing.h"
#include "planar.h"
#include "raster.h"
#include "repel.h"
#include "ssim.h"
#include "sweep.h"
#include "views.h"

namespace p2gs {

struct Kernels {
    const char* isa;
    AdamKernels adam;
    BlendKernels blend;
    CarryKernels carry;
    ImageKernels image;
    SsimKernels ssim;
    RasterKernels raster;
    KnnKernels knn;
    LandingKernels landing;
    GraphKernels graph;
    ViewKernels views;
    EvidenceKernels evidence;
    AssignKernels assign;
    RepelKernels repel;
    FuseKernels fuse;
    PlanarKernels planar;
    SweepKernels sweep;
};

namespace avx512 { extern const Kernels table; }
namespace avx2 { extern const Kernels table; }
namespace portable { extern const Kernels table; }

// The kernels in use: the best this machine runs, or the one named by the environment variable P2GS_ISA or by set_isa.
const Kernels& kernels();

// False when the name is unknown or this machine cannot run it.
bool set_isa(const char* name);

// The instruction sets this machine runs, best first, ended by a null pointer.
const char* const* available_isas();

}  // namespace p2gs
